import pytest

from slimsfm.evaluation.benchmark import Method, parse_method


@pytest.mark.parametrize(
    ("text", "method"),
    [
        ("sift", Method("sift")),
        ("aliked", Method("aliked")),
        ("aliked+lightglue", Method("aliked", "lightglue")),
        ("superpoint+superglue", Method("superpoint", "superglue")),
        ("sift+nearest", Method("sift", "nearest")),
        ("loftr", Method("loftr")),
    ],
)
def test_a_method_is_an_extractor_with_or_without_a_matcher(text, method):
    assert parse_method(text) == method
    assert str(method) == text


@pytest.mark.parametrize("text", ["", "guess", "lightglue", "SIFT", "+lightglue", "guess+lightglue", " sift"])
def test_an_unknown_extractor_is_an_error(text):
    with pytest.raises(ValueError, match=r"the extractor of a method must be one of .*sift.*, got '.*'"):
        parse_method(text)


@pytest.mark.parametrize("text", ["aliked+", "aliked+guess", "aliked+sift", "aliked+lightglue+superglue"])
def test_an_unknown_matcher_is_an_error(text):
    with pytest.raises(ValueError, match=r"the matcher of a method must be one of .*lightglue.*, got '.*'"):
        parse_method(text)
