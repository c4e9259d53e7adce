"""Flexible bodies of many elements: the same beam here, in C and in exudyn."""
