"""What all figures share: fonts, sizes, colours, units, the page around the axes, charts, and the files."""
