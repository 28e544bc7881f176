"""Reading and writing of plain files: text, tables, YAML, trajectories, atomic replacement."""
