"""A draft of the paper about the library: paper.md, made from the committed numbers of the other folders."""
