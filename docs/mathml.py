"""Formulas of notebooks and pages as MathML, which browsers show themselves: no script, no fonts, no network."""

import re

from docutils.nodes import SkipNode
from latex2mathml.converter import convert

FUNCTIONS = r"<mi>(?:sin|cos|tan|exp|log|ln|max|min)</mi>"
SPACE = '<mspace width="0.17em"/>'


def mathml(latex, display):
    """With accents of full size, and some room about the names of functions."""
    formula = convert(latex, display=display).replace("<mover>", '<mover accent="true">')
    return re.sub(FUNCTIONS, rf"{SPACE}\g<0>{SPACE}", formula)


def inline(translator, node):
    translator.body.append(mathml(node.astext(), "inline"))
    raise SkipNode


def block(translator, node):
    translator.body.append(f'<div class="math">{mathml(node.astext(), "block")}</div>')
    raise SkipNode


def setup(app):
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    return {"parallel_read_safe": True}
