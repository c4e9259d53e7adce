"""What reading on a screen asks of pages: names in code lead to where they are documented, tables fit a phone."""

import re

from docutils import nodes
from plain_text import NAMES
from sphinx.util.nodes import make_refnode

SHORT = 3  # columns of a table whose cells stand below each other on a phone


def link_names(app, doctree, page):
    """`simulate(..., dt=...)` in a text becomes a link to `hhtjax.simulate`."""
    objects = app.env.get_domain("py").objects
    for literal in list(doctree.findall(nodes.literal)):
        text = literal.astext()
        name = NAMES.get(re.match(r"[\w.]*", text)[0])
        if name not in objects or is_within(literal, (nodes.reference, nodes.title, nodes.term)):
            continue
        target = objects[name]
        link = make_refnode(app.builder, page, target.docname, target.node_id, literal.deepcopy(), name)
        literal.replace_self(link)


def is_within(node, kinds):
    """Whether one of the nodes around it is of these kinds."""
    while node.parent is not None:
        node = node.parent
        if isinstance(node, kinds):
            return True
    return False


def tell_tables_apart(app, doctree, page):
    """Tables of a few columns of text are stacked on a phone; those of numbers can be moved sideways."""
    for table in doctree.findall(nodes.table):
        columns = len(list(table.findall(nodes.colspec)))
        table["classes"].append("stacked" if columns <= SHORT else "wide")


def setup(app):
    app.connect("doctree-resolved", link_names)
    app.connect("doctree-resolved", tell_tables_apart)
    return {"parallel_read_safe": True}
