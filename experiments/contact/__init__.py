"""Contacts that rest, stick, slide, let go and land."""
