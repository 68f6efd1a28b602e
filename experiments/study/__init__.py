"""The matrix of experiments: what is run (`plan`), running it (`execute`, `work`), and what it says (`tables`)."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as the command does (`cli.console`)
