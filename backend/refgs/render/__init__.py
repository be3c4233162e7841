"""Render surfels: rasterise and shade them, relight them, and extract their surface."""
