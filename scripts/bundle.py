"""Puts the scenes and the gallery, which lie beside the packages, into the wheel; pyproject.toml names it."""

from pathlib import Path

from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parents[1]
BUNDLED = {
    "scenes/*.toml": "spherloc/datasets/scenes",
    "scenes/*.npz": "spherloc/datasets/scenes",
    "recordings/gallery.toml": "spherloc_viz/gallery",
}
"""Files of the checkout, and the folder of a package where an installation looks for them."""


class BuildWithBundle(build_py):
    """Builds the packages; an editable installation finds the files in the checkout instead."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        for target, source in self._bundled().items():
            self.mkpath(str(Path(target).parent))
            self.copy_file(source, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        return [*super().get_outputs(include_bytecode), *self._bundled()]

    def get_output_mapping(self) -> dict[str, str]:
        return super().get_output_mapping() | self._bundled()

    def get_source_files(self) -> list[str]:
        return [*super().get_source_files(), *self._bundled().values()]

    def _bundled(self) -> dict[str, str]:
        """The files of the build by where they come from, relative to the checkout."""
        pairs = ((path, folder) for pattern, folder in BUNDLED.items() for path in sorted(ROOT.glob(pattern)))
        return {
            str(Path(self.build_lib, folder, path.name)): path.relative_to(ROOT).as_posix() for path, folder in pairs
        }
