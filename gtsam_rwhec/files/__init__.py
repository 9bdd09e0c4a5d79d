"""Small helpers for files: YAML with line numbers, atomic writes, natural order of names, printable text."""
