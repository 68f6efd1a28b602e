"""The matrix of experiments: what is run (`plan`), running it (`execute`, `work`), and what it says (`tables`)."""
