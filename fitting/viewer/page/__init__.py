"""The page of the viewer, with viser: the only modules that import it.

`server` opens the page, `figure` draws, `panel` has the sliders, `player` the time, and `viewer`
connects them with the system that is moved.
"""

from .server import address as address
from .server import open_server as open_server
from .server import stop as stop
from .viewer import Viewer as Viewer
