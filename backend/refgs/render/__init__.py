"""Pictures from surfels: rasterising, shading, comparing."""
