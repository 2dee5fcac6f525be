"""The colours of pictures and of the viewer.

Scales are those of matplotlib whose lightness rises all along, so that nobody needs to see hues.
Space of which a map knows nothing is grey, which is in none of them. The other colours are Okabe
and Ito's, which all can distinguish.
"""

from matplotlib import colormaps
from matplotlib.colors import Colormap, LinearSegmentedColormap
from triquad_map.height_scale import HEIGHT_STOPS

UNKNOWN = "#bdbdbd"
FREE = "#f3f3f3"
BEHIND = "#d55e00"  # what lies behind a surface
HEIGHTS: Colormap = LinearSegmentedColormap.from_list("heights", HEIGHT_STOPS.tolist())
MOVEMENT: Colormap = colormaps["plasma_r"]
DISTANCES = colormaps["viridis"].with_extremes(under=BEHIND)
"""The colours of distances from 0 up; those behind a surface stand out."""

APPEARED, VANISHED, NEWLY_SEEN, NO_LONGER_KNOWN = "#0072b2", "#d55e00", "#56b4e9", "#f0e442"
