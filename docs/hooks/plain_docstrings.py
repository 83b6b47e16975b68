"""Docstrings are plain text: keep shapes, powers and doctests from being read as Markdown."""

import re

import griffe

_CODE = re.compile(r"(`+[^`]*`+)")
_SECTION = re.compile(r"[A-Z][a-z]+:\s*$")


def _escape(line: str) -> str:
    parts = _CODE.split(line)
    parts[::2] = [re.sub(r"([\[\]^~*])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)


def to_markdown(text: str) -> str:
    """Return the docstring with its equations and doctests as blocks of code and the rest escaped."""
    lines: list[str] = []
    state, previous = "text", ""
    for line in text.splitlines():
        indented = line.startswith("    ")
        if state == "doctest" and not line.strip():
            lines.append("```")
            state = "text"
        elif state == "equation" and not indented:
            lines.append("")
            state = "text"
        if state in ("text", "section") and line.startswith(">>> "):
            lines += ["", "```pycon"]
            state = "doctest"
        elif state == "text" and indented and previous and not previous.startswith("  "):
            inside_section = _SECTION.match(previous)
            state = "section" if inside_section else "equation"
            if not inside_section:
                lines.append("")
        elif state == "section" and line and not indented:
            state = "text"
        lines.append(line if state in ("doctest", "equation") else _escape(line))
        previous = line if line.strip() else previous if state == "section" else ""
    if state == "doctest":
        lines.append("```")
    return "\n".join(lines)


class PlainDocstrings(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_object(self, *, obj: griffe.Object, **_) -> None:
        if obj.docstring is not None:
            obj.docstring.value = to_markdown(obj.docstring.value)
