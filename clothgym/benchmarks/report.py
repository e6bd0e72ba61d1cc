"""What leaves the program: tables for terminal and page, strict JSON, one self-contained HTML page."""

from __future__ import annotations

import base64
import html
import io
import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from clothgym.benchmarks.machine import provenance

_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Table:
    """A table for terminal, page and JSON.

    Attributes:
        title: One line.
        columns: Column names, units in brackets ("length [m]").
        rows: Cells of any JSON type; one entry per column in every row.
        note: What to read out of it; optional.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    note: str = ""

    def __post_init__(self) -> None:
        for number, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table {self.title!r}: row {number} has {len(row)} cells, expected {len(self.columns)}"
                )

    def to_json(self) -> dict[str, Any]:
        """Title, columns, rows and note as JSON values."""
        document = {"title": self.title, "columns": list(self.columns), "rows": list(self.rows), "note": self.note}
        return json_ready(document)

    def to_rich(self) -> Any:
        """The table as a `rich.table.Table` without its title and note; cells are text, never markup."""
        import rich.box
        import rich.table
        import rich.text

        table = rich.table.Table(box=rich.box.SIMPLE_HEAD)
        for index, column in enumerate(self.columns):
            justify: Literal["left", "right"] = "right" if _is_numeric_column(self.rows, index) else "left"
            table.add_column(rich.text.Text(column), justify=justify, overflow="fold")
        for row in self.rows:
            table.add_row(*(rich.text.Text(format_value(cell)) for cell in row))
        return table


def _is_numeric_column(rows: Sequence[Sequence[Any]], index: int) -> bool:
    cells = [row[index] for row in rows if row[index] is not None]
    return bool(cells) and all(isinstance(c, int | float | np.number) and not isinstance(c, bool) for c in cells)


def format_value(value: Any) -> str:
    """A cell as text: four significant digits, yes/no for bool, a dash for None."""
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        size = abs(float(value))
        if value == 0 or not math.isfinite(value):
            return f"{value:g}"
        if size >= 1e7 or size < 1e-4:
            return f"{value:.3e}"
        return f"{value:.0f}" if size >= 1000 else f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{key}={format_value(cell)}" for key, cell in value.items())
    if isinstance(value, list | tuple | np.ndarray):
        return ", ".join(format_value(cell) for cell in value)
    return str(value)


def json_ready(value: Any) -> Any:
    """Plain JSON values: numpy scalars and arrays become numbers and lists, paths text, numbers that are not finite
    null (strict JSON has no other word for them).

    Raises:
        TypeError: names the type that has no JSON form, or a key that is no text.
    """
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.ndarray):
        return json_ready(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"key {key!r} is {type(key).__name__}: JSON needs text")
        return {key: json_ready(cell) for key, cell in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(cell) for cell in value]
    raise TypeError(f"{type(value).__name__} has no JSON form")


def to_json_text(value: Any, indent: int | None = None) -> str:
    """Strict JSON text of `json_ready(value)`."""
    return json.dumps(json_ready(value), indent=indent, ensure_ascii=False, allow_nan=False)


def print_table(table: Table) -> None:
    """Prints a table on standard output; unwrapped when that is no terminal, so that pipes see whole cells."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=4000)
    # Title and note apart: inside, they would wrap at the width of a narrow table.
    console.print(table.title, markup=False, style="bold")
    console.print(table.to_rich())
    if table.note:
        console.print(table.note, markup=False)


def error_table(rows: Sequence[dict[str, Any]]) -> Table:
    """The failed cases with the first line of their error."""
    return Table("Failed cases", ("key", "error"), [(row["key"], row["error"]) for row in rows if "error" in row])


def origin_table(rows: Sequence[dict[str, Any]] = ()) -> Table:
    """Machine, versions and commit: of the rows when there are some (several values when they differ), else of this
    process."""
    origins = [(row.get("machine", {}), row.get("versions", {}), row.get("commit")) for row in rows]
    if not origins:
        here = provenance()
        origins = [(here["machine"], here["versions"], here["commit"])]
    cells: dict[str, list[str]] = {}
    for where, what, commit in origins:
        for name, value in [*where.items(), *what.items(), ("commit", commit)]:
            text = "-" if value is None else str(value)
            seen = cells.setdefault(name.replace("_", " "), [])
            if text not in seen:
                seen.append(text)
    if rows:
        started = [row["started"] for row in rows if row.get("started")]
        cells["rows"] = [str(len(rows))]
        cells["first started"] = [min(started, default="-")]
        cells["seconds, sum over cases"] = [f"{sum(row.get('seconds') or 0.0 for row in rows):.1f}"]
    return Table("Origin", ("what", "value"), [(name, "; ".join(values)) for name, values in cells.items()])


def write_atomically(path: str | Path, data: bytes) -> Path:
    """Writes beside the target and renames: a kill leaves the old file or the new one, never half of one."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return path


_STYLE = """
:root { color-scheme: light dark; --ink: #1b1e23; --soft: #5a626d; --line: #d5d9df; --paper: #ffffff;
  --band: #f5f6f8; --mark: #1f5fa8; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8eb; --soft: #a3abb6; --line: #3a4049; --paper: #16181c;
  --band: #1e2126; --mark: #7db4f0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 72rem; color: var(--ink); background: var(--paper);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 1rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; color: var(--mark); }
p { max-width: 46rem; margin: .6rem 0; white-space: pre-line; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; margin: 1.2rem 0; }
table { border-collapse: collapse; font-size: .9rem; }
caption { text-align: left; font-weight: 600; padding: 0 0 .4rem; }
th, td { padding: .3rem .75rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
th { color: var(--soft); font-weight: 600; border-bottom-width: 2px; }
td { overflow-wrap: anywhere; }
th.number, td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tbody tr:nth-child(even) { background: var(--band); }
.note, figcaption { color: var(--soft); font-size: .9rem; margin: .3rem 0 0; max-width: 46rem; white-space: pre-line; }
figure { margin: 1.4rem 0; }
img { max-width: 100%; height: auto; background: #ffffff; border: 1px solid var(--line); border-radius: 4px; }
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(18rem, 1fr)); gap: 1rem; }
.gallery figure { margin: 0; }
"""


class Page:
    """One HTML page that needs nothing beside itself: no scripts, no fonts, no network; pictures are inside.

    Every method but `write` returns the page, so calls can be chained. All text is escaped.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self._parts: list[str] = []

    def add_heading(self, text: str) -> Page:
        """A section heading."""
        self._parts.append(f"<h2>{_escape(text)}</h2>")
        return self

    def add_text(self, text: str) -> Page:
        """Paragraphs, split at blank lines; single line breaks are kept."""
        for paragraph in text.strip().split("\n\n"):
            if paragraph.strip():
                self._parts.append(f"<p>{_escape(paragraph.strip())}</p>")
        return self

    def add_table(self, table: Table) -> Page:
        """A table; columns of numbers are right-aligned."""
        numeric = [_is_numeric_column(table.rows, index) for index in range(len(table.columns))]
        classes = [' class="number"' if n else "" for n in numeric]
        head = "".join(f"<th{c}>{_escape(column)}</th>" for c, column in zip(classes, table.columns))
        body = "".join(
            "<tr>" + "".join(f"<td{c}>{_escape(format_value(cell))}</td>" for c, cell in zip(classes, row)) + "</tr>\n"
            for row in table.rows
        )
        note = f'<p class="note">{_escape(table.note)}</p>' if table.note else ""
        self._parts.append(
            f'<div class="scroll"><table><caption>{_escape(table.title)}</caption>\n'
            f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table>{note}</div>"
        )
        return self

    def add_image(self, image: str | Path | bytes | np.ndarray, caption: str = "") -> Page:
        """A picture: path of a PNG, its bytes, or pixels (H,W,3) or (H,W,4) uint8.

        Raises:
            ValueError: the bytes are no PNG, or the pixels have another shape or type.
        """
        self._parts.append(_figure(image, caption))
        return self

    def add_gallery(self, images: Iterable[tuple[str | Path | bytes | np.ndarray, str]]) -> Page:
        """Pictures with captions side by side, as many in a row as fit."""
        figures = "".join(_figure(image, caption) for image, caption in images)
        self._parts.append(f'<div class="gallery">{figures}</div>')
        return self

    def to_html(self) -> str:
        """The whole document."""
        policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
        body = "\n".join(self._parts)
        return (
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{_escape(self.title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
            f"<body>\n<h1>{_escape(self.title)}</h1>\n{body}\n</body>\n</html>\n"
        )

    def write(self, path: str | Path) -> Path:
        """Writes the page; the old one stays until the new one is whole."""
        return write_atomically(path, self.to_html().encode("utf-8"))


def _escape(text: str) -> str:
    return html.escape(str(text), quote=True)


def _figure(image: str | Path | bytes | np.ndarray, caption: str) -> str:
    data = base64.b64encode(_png_bytes(image)).decode("ascii")
    below = f"<figcaption>{_escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{_escape(caption)}" src="data:image/png;base64,{data}">{below}</figure>'


def _png_bytes(image: str | Path | bytes | np.ndarray) -> bytes:
    if isinstance(image, np.ndarray):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
            raise ValueError(f"image: expected uint8 pixels (H, W, 3|4), got {image.dtype} {image.shape}")
        from PIL import Image

        buffer = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(image)).save(buffer, format="png")
        return buffer.getvalue()
    name = "image" if isinstance(image, bytes) else str(image)
    data = image if isinstance(image, bytes) else Path(image).read_bytes()
    if not data.startswith(_PNG):
        raise ValueError(f"{name}: not a PNG picture")
    return data
