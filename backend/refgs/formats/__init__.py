"""File formats, and the plain arrays that they hold: PLY, EXR, glTF, OBJ, COLMAP's model, history.jsonl. No torch."""
