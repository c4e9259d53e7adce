"""What the pages of experiments share, which are made from committed numbers."""


def table(header, rows):
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def find(entries, **keys):
    """The one entry with these values."""
    (entry,) = (e for e in entries if all(e[key] == value for key, value in keys.items()))
    return entry
