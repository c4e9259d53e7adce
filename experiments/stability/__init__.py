"""Where every method fails: methods x scenes x step sizes x numerical damping."""
