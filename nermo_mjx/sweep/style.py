"""The names of `nermo_mjx.plotting` that the benchmarks' page takes from here."""

from nermo_mjx.plotting.files import lay_out, write_figure
from nermo_mjx.plotting.page import page
from nermo_mjx.plotting.style import BEST, LINE, MUTED, STYLE, horizontal_grid

__all__ = ["BEST", "LINE", "MUTED", "STYLE", "horizontal_grid", "lay_out", "page", "write_figure"]
