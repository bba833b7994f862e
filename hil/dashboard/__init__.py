"""The window: a page that shows a run while it goes on, served by a process of its own.

rings, counters --look 50 times a second--> `view` --JSON over a websocket--> page (static/)
orders (align, mark, record, fault) <------------------ buttons
"""

from hil.dashboard.address import Window, open_window
from hil.dashboard.server import run_dashboard
from hil.dashboard.view import Sources, View, recording_name

__all__ = ["Sources", "View", "Window", "open_window", "recording_name", "run_dashboard"]
