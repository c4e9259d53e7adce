"""Mathematics that knows nothing of mechanics: solves, scans, loops whose length is data, extrapolation."""
