import re
import subprocess
import sys
from pathlib import Path

from PIL import Image

from slimsfm.synthetic.scene import mapping_take

README = Path(__file__).parents[1] / "README.md"


def test_the_python_lines_run_and_print_a_pose(tmp_path):
    lines = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(lines) == 1
    take = mapping_take("printed_box", 80, 320, 240, seed=0)
    (tmp_path / "photos").mkdir()
    for frame in range(8):
        Image.fromarray(take.frame(frame)).save(tmp_path / "photos" / f"{frame}.png")
    Image.fromarray(take.frame(3)).save(tmp_path / "query.jpg")
    done = subprocess.run(
        [sys.executable, "-c", lines[0]], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    *matrix, confidence = map(float, re.findall(r"-?\d\.\d+", done.stdout))
    assert len(matrix) == 12
    assert 0.5 <= confidence <= 1


def test_the_two_commands_are_given():
    text = README.read_text()
    assert "pip install . && slimsfm demo" in text
    assert "pip install -e '.[all,test]' && pytest" in text
