"""Objects: shapes, textures, materials and captions."""
