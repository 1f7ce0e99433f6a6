"""A common look for all figures: fonts, sizes, colours, units, the page around the axes, and the files."""
