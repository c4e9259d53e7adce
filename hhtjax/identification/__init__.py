"""Parameters from measurements, and how far to trust them; the public names are those of `hhtjax`."""
