"""The report of a training run: one file that shows its data, recipe, network, losses and driving."""
