"""Read and write files: PLY, EXR, glTF, OBJ, COLMAP's models, history.jsonl, hints.json. Nothing here imports torch."""
