"""Files: the only package that opens them; each heavy dependency has one home here."""
