import numpy as np
import pytest

from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.scene import object_box


@pytest.mark.parametrize("make", OBJECTS.values(), ids=OBJECTS.keys())
def test_an_object_is_metric_centered_closed_and_textured(make):
    mesh = make(0)
    box = object_box(mesh)
    assert 0.1 < box.diagonal < 0.35
    assert np.allclose(box.center, 0, atol=1e-12)
    assert mesh.volume > 0.3 * np.prod(mesh.extents)  # faces look outward and leave no hole
    assert np.all((mesh.visual.uv >= 0) & (mesh.visual.uv <= 1))


@pytest.mark.parametrize("make", OBJECTS.values(), ids=OBJECTS.keys())
def test_the_seed_alone_decides_the_print(make):
    images = [np.asarray(make(seed).visual.material.image) for seed in (3, 3, 4)]
    assert np.array_equal(images[0], images[1])
    assert images[0].shape != images[2].shape or not np.array_equal(images[0], images[2])
