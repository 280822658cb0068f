from spherloc_viz.showing import Playground as Playground
from spherloc_viz.showing import show as show

EXPORTS: tuple[str, ...]
