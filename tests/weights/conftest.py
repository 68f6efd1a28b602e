from torch_files import write_torch  # noqa: F401, a fixture of this folder
