"""The campaigns of the paper, one TOML file each."""
