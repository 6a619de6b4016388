"""One run: the training loop, its folder, its files, where it starts from."""
