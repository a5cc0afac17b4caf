"""Runs: folders with the settings, weights and predictions of one trained avatar or canonicalizer."""
