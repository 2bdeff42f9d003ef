"""From labelled segments and maps to a dataset: its inputs, its coverage, its splits, and its files."""
