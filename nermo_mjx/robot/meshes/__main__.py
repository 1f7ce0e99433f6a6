"""`python -m nermo_mjx.robot.meshes`: rewrite the mesh files, after one of the robot's numbers has changed."""

from __future__ import annotations

from nermo_mjx.robot.meshes.body import mesh_texts
from nermo_mjx.robot.parts import mjcf_directory


def main() -> None:
    """Write all files, and remove obsolete ones."""
    folder = mjcf_directory() / "meshes"
    folder.mkdir(exist_ok=True)
    texts = mesh_texts()
    for path in folder.glob("*.obj"):
        if path.name not in texts:
            path.unlink()
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="ascii", newline="\n")
    print(f"{len(texts)} meshes, {sum(map(len, texts.values())) / 1000:.0f} kB, in {folder}")


if __name__ == "__main__":
    main()
