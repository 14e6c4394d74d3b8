"""The commands of `refu`, and all that measures; imported by none of the other packages."""
