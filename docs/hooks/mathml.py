"""Formulas become MathML while the site is built, so that pages need no script and no network."""

import html
import re

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*(?:\\\((?P<inline>.*?)\\\)|\\\[(?P<block>.*?)\\\])\s*'
    r"</(?P=tag)>",
    re.DOTALL,
)


def on_page_content(text: str, page, **_) -> str:
    """Replace what pymdownx.arithmatex marked as a formula."""

    def to_mathml(match: re.Match) -> str:
        block = match["block"]
        tex = html.unescape(block if block is not None else match["inline"]).strip()
        try:
            formula = convert(tex, display="inline" if block is None else "block")
        except Exception as error:
            raise PluginError(f"{page.file.src_uri}: cannot convert {tex!r}: {error!r}") from error
        return formula if block is None else f'<div class="formula">{formula}</div>'

    return _FORMULA.sub(to_mathml, text)
