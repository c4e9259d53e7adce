"""What the pages of experiments share, which are made from committed numbers."""


def table(header, rows):
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def find(entries, **keys):
    """The one entry with these values."""
    (entry,) = (e for e in entries if all(e[key] == value for key, value in keys.items()))
    return entry


def busy(machine):
    """A warning where others kept the machine busy while its times were taken."""
    load = machine["load_at_start"]
    return (
        " (other programs ran: all times are too long, and ratios are rough)"
        if load and load > machine["cores"] / 2
        else ""
    )
