"""Charts and views in two dimensions, as SVG."""
