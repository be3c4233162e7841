"""RefGS: photographs of shiny objects into relightable surfels, textured meshes and light."""

__version__ = "0.1.0"
