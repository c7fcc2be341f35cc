"""What a command shows: results on stdout, and on stderr what it is busy with.

On a terminal, rich draws tables and bars; in a pipe, a file, or on a terminal that can do no more
(`TERM=dumb`), there are plain lines without escape codes. `printing` shows results, `watching`
shows work in one of two ways: `live_lines` and `plain_lines`. Commands only use the two names here.
"""

from .printing import show as show
from .watching import watched as watched
