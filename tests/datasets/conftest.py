from manifest_world import make, read_back, rich, settings  # noqa: F401, fixtures of this folder
