"""What all figures share: fonts, sizes, colours, units, the page around the axes, charts, and the files."""

from nermo_mjx.plotting.style import FOOT, STYLE

__all__ = ["FOOT", "STYLE"]
