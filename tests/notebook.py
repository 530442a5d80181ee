"""Run a notebook's cells and write what Jupyter would show: `python tests/notebook.py NOTEBOOK OUT.html`."""

import ast
import base64
import contextlib
import html
import io
import json
import sys
import warnings
from pathlib import Path
from typing import Any


def shown(value: Any) -> str:
    """A value as Jupyter shows it: by its own HTML, else its picture, else its text."""
    if callable(made := getattr(value, "_repr_html_", None)) and (text := made()) is not None:
        return str(text)
    if callable(made := getattr(value, "_repr_png_", None)):
        return f'<img src="data:image/png;base64,{base64.b64encode(made()).decode()}"/>'
    return f"<pre>{html.escape(repr(value))}</pre>"


def page(notebook: Path) -> str:
    """The page of a notebook whose cells are run here, in the folder that is the current one."""
    parts, namespace = list[str](), {"__name__": "__main__"}
    for number, cell in enumerate(json.loads(notebook.read_text(encoding="utf-8"))["cells"]):
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(f"<p>{html.escape(text)}</p>")
            continue
        tree, said = ast.parse(text), io.StringIO()
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        with contextlib.redirect_stdout(said), warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            exec(compile(tree, f"cell {number}", "exec"), namespace)
            value = (
                eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), namespace)
                if last
                else None
            )
        notes = said.getvalue() + "".join(f"{note.category.__name__}: {note.message}\n" for note in told)
        parts.append(f"<pre style='background:#eee'>{html.escape(text)}</pre>")
        parts += [f"<pre>{html.escape(notes)}</pre>"] if notes else []
        parts += [shown(value)] if value is not None else []
    head = f"<title>{notebook.stem}</title><style>img {{max-width: 100%}}</style>"
    return f"<!doctype html><meta charset='utf-8'>{head}{''.join(parts)}"


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(page(Path(sys.argv[1])), encoding="utf-8")
