"""A part of a film or picture, for a small tile: `python docs/crop.py FILE LEFT TOP RIGHT BOTTOM OUT.webp` [pixels].

A negative number counts from the other side, so that a longer caption above the picture moves nothing.
"""

import sys

from PIL import Image, ImageSequence

if __name__ == "__main__":
    source, *numbers, target = sys.argv[1:]
    frames, durations = [], []
    with Image.open(source) as film:
        sides = [int(number) for number in numbers]
        box = [side + size if side < 0 else side for side, size in zip(sides, 2 * film.size, strict=True)]
        for frame in ImageSequence.Iterator(film):
            frames.append(frame.convert("RGB").crop(box))
            durations.append(frame.info.get("duration", 0))
    frames[0].save(target, save_all=True, append_images=frames[1:], duration=durations, loop=0, quality=85, method=6)
