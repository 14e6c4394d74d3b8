"""The commands of `refu` and everything that measures; none of the other packages imports it."""
