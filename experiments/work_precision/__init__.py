"""Error against time, against other packages."""
