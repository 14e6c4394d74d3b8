"""A viewer in the browser: recorded motion, dressed while you look, or garments as they were recorded."""

from refu_lab.view._view import view as view
