"""Adds the notebook of the examples to the site as a page."""

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

NOTEBOOK = "examples/slimsfm.ipynb"
PAGE = "walkthrough.md"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page and its pictures."""
    path = Path(config.config_file_path).parent / NOTEBOOK
    parts: list[str] = []
    for part in parts_of(json.loads(path.read_text(encoding="utf-8"))):
        if isinstance(part, bytes):
            name = f"walkthrough/{sum(one.startswith('![') for one in parts) + 1}.png"
            files.append(File.generated(config, name, content=part))
            part = f"![Output of the code above](../docs/{name})"
        parts.append(part)
    parts.append(f'Download the notebook: <a href="{NOTEBOOK}" download><code>slimsfm.ipynb</code></a>.')
    files.append(File.generated(config, PAGE, content="\n\n".join(parts) + "\n"))
    return files


def parts_of(notebook: dict[str, Any]) -> Iterator[str | bytes]:
    """Yield the text of the page in order, and pictures as bytes of a PNG."""
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            yield source
            continue
        yield f"```python\n{source}\n```"
        for output in cell["outputs"]:
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "image/png" in data:
                yield base64.b64decode("".join(data["image/png"]))
            elif "text/plain" in data:
                yield f"```text\n{''.join(data['text/plain']).rstrip()}\n```"
