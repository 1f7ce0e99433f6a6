"""Keeps the last seconds of a recording, for a short film: `python docs/cut.py FILE.npz SECONDS OUT.npz`."""

import sys

from nermo_mjx import Recording

if __name__ == "__main__":
    source, seconds, target = sys.argv[1:]
    recording = Recording.load(source)
    recording.between(recording.time[-1] - float(seconds), recording.time[-1]).save(target)
