"""From labelled segments and maps to a dataset: what goes in, what it covers, how it is split, and how it is written."""
