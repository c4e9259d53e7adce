"""Teaching notebooks: percent scripts, rendered beside them."""
