import base64
from types import SimpleNamespace

import pytest

from slimsfm.cli import COMMANDS
from slimsfm.cli.options import options_of


def test_a_formula_becomes_mathml_and_the_rest_stays(hook):
    html = '<p>An <span class="arithmatex">\\(e_{uv} &lt; 0.05\\)</span> edge, <code>$x$</code></p>'
    made = hook("mathematics").on_page_content(html)
    assert made.startswith('<p>An <math xmlns="http://www.w3.org/1998/Math/MathML" display="inline">')
    assert "<msub><mi>e</mi>" in made
    assert "&#x0003C;" in made or "&lt;" in made
    assert made.endswith("</math> edge, <code>$x$</code></p>")


def test_a_displayed_formula_has_its_own_line(hook):
    made = hook("mathematics").on_page_content('<div class="arithmatex">\\[\n\\frac{1}{8 d}\n\\]</div>')
    assert 'display="block"' in made
    assert "<mfrac>" in made


@pytest.mark.parametrize("command", ["localize", "benchmark images", "export hloc"])
def test_every_option_of_a_command_is_a_row_of_its_tables(hook, command):
    section = hook("commands").section_of(command)
    assert f"```sh\nslimsfm {command} " in section
    rows = [line.strip() for line in section.splitlines() if line.strip().startswith("| `")]
    options = options_of(COMMANDS[command].load())
    assert len(rows) == len(options)
    for row, option in zip(rows, options, strict=True):
        assert row.startswith(f"| `{', '.join(option.flags) or option.metavar}")
        assert row.count(" | ") == 2
        assert option.help


def test_a_section_of_an_unknown_command_is_an_error(hook):
    with pytest.raises(KeyError, match="fly"):
        hook("commands").section_of("fly")


@pytest.mark.parametrize(
    ("page", "link", "on_site"),
    [
        ("learned.md", "../examples/own_matcher/own_matcher.py", "examples/own_matcher/own_matcher.py"),
        ("how-to/colmap.md", "../method.md", "../method.md"),
        ("how-to/colmap.md", "../../CHANGELOG.md", "../changelog.md"),
        ("contributing.md", "docs/architecture.md", "architecture.md"),
        ("walkthrough.md", "../docs/method.md", "method.md"),
        ("index.md", "../README.md", "index.md"),
        ("index.md", "https://example.org/a.md", "https://example.org/a.md"),
        ("index.md", "#in-python", "#in-python"),
    ],
)
def test_links_between_files_become_links_between_pages(hook, page, link, on_site):
    asking = SimpleNamespace(file=SimpleNamespace(src_uri=page))
    made = hook("repository").on_page_markdown(f"[one]({link}), [`two`]({link})", page=asking)
    assert made == f"[one]({on_site}), [`two`]({on_site})"


@pytest.mark.parametrize("code", ["`solve[name](problem)`", "```python\nsolve[name](problem)\n```"])
def test_code_has_no_links(hook, code):
    asking = SimpleNamespace(file=SimpleNamespace(src_uri="how-to/colmap.md"))
    assert hook("repository").on_page_markdown(code, page=asking) == code


def test_a_notebook_becomes_text_code_outputs_and_pictures(hook):
    picture = base64.b64encode(b"a picture").decode()
    cells = [
        {"cell_type": "markdown", "source": ["# Title\n", "Words."]},
        {
            "cell_type": "code",
            "source": ["print(1)"],
            "outputs": [
                {"output_type": "stream", "name": "stdout", "text": ["1\n"]},
                {"output_type": "display_data", "data": {"image/png": picture, "text/plain": ["<Figure>"]}},
            ],
        },
    ]
    parts = list(hook("notebook").parts_of({"cells": cells}))
    assert parts == ["# Title\nWords.", "```python\nprint(1)\n```", "```text\n1\n```", b"a picture"]
