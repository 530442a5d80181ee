"""How-to: the page that lies beside what was exported, for whoever opens it without knowing magtwin."""

from collections.abc import Mapping, Sequence
from shlex import quote

_HEAD = """# {name}, exported by magtwin {version}

Open `{root}`. Metres, kilograms, Z up; x is east and y north. Nothing outside is named, so it may
be moved anywhere.
"""

_RUN = """
`{run}` plays a run over the stage: the robot moves, its wheels turn, and its sensors' readings
are time samples on their prims. Bodies are moved by their transforms: to look at, not for physics
to simulate.
"""

_OPEN = """
## Opening it

- Omniverse, Isaac Sim: File > Open. Isaac Lab: `sim_utils.UsdFileCfg(usd_path="{root}")`.
- usdview, Blender (File > Import > Universal Scene Description): as it is.
- Newton: `newton.ModelBuilder().add_usd("{root}")`.
- Python: `Usd.Stage.Open("{root}")`, with `pip install usd-core`.
"""

_PLUGIN = """
## The schemas

What magtwin adds are applied API schemas on plain Xforms, so every program places and keeps it
all without knowing them. To see the attributes with their documentation and fallbacks, name the
folder `plugin/magtwin` in `PXR_PLUGINPATH_NAME` before the program starts:

    PXR_PLUGINPATH_NAME=/where/this/lies/plugin/magtwin isaac-sim.sh

In a Kit extension instead, on startup and before a stage is opened:

    from pxr import Plug
    Plug.Registry().RegisterPlugins("/where/this/lies/plugin/magtwin")
"""

_MAP = """
## The map

`{map}` holds the magnetic anomaly map: `magtwin:anomalyMap:values` [nT], flat, in (heading, y, x)
order, with `shape`, `origin` [m], `cellSize` [m], `headings` [deg] and a checksum. Its child
`HeatMap` shows it; the variant set `heading` there chooses which heading is shown.
"""

_FLAT_MAP = """
## The map

`{map}` holds the magnetic anomaly map: `magtwin:anomalyMap:values` [nT], flat, in (heading, y, x)
order, with `shape`, `origin` [m], `cellSize` [m], `headings` [deg] and a checksum. Its child
`HeatMap` shows one heading of it.
"""

_NETWORK = """
## The network

`magtwin:magnetometer:network` of `{prim}` names the weights; what it predicts is added to the
map's field. Its inputs stand in `magtwin:magnetometer:inputs`, in order. An `.onnx` beside the
weights is the same network for any runtime: input `features`, outputs in nT.
"""

_ATTACHED = """
A .usdz may hold no such file: its bytes are `magtwin:file:bytes` of the prims below `Files`, and
the files themselves lie in `weights` beside this page. `magtwin export FILE.usdz --out DIR` makes
a folder of it all.
"""

_ISAAC = """
## Isaac Sim

Enable the extension `isaacsim.ros2.bridge`, open the stage and press Play. The Action Graphs
below `{graphs}` publish `/clock`, odometry, inertial unit, pose, joint states and scan, and take
`/robot/cmd_vel`. The robot's asset has Isaac Sim's asset structure 3.0; its variant set `Physics`
chooses the engine. The graphs were held against the published definitions of their nodes, and not
run in Isaac Sim.
"""

_SCRIPT = """
`{script}` drives the robot along a figure of eight and reads the magnetometer at every
step, without magtwin; its first lines say what it needs, and whether it was tested.

    {python} {script} {root} {onnx} readings.csv
"""

_LICENCES = """
## Where it comes from

Made from `{source}`, SHA-256 `{checksum}`. Licences:

{licences}
"""


def howto(
    *,
    name: str,
    version: str,
    root: str,
    run: str = "",
    flat: bool = False,
    plugin: bool = True,
    map_prim: str = "",
    magnetometer: str = "",
    attached: bool = False,
    graphs: str = "",
    scripts: Sequence[str] = (),
    onnx: str = "",
    source: str,
    checksum: str,
    licences: Mapping[str, str],
    notes: Sequence[str] = (),
) -> str:
    """The page, with the sections that what was exported needs."""
    parts = [_HEAD.format(name=name, version=version, root=root)]
    if run:
        parts.append(_RUN.format(run=run))
    parts.append(_OPEN.format(root=root))
    if graphs:
        parts.append(_ISAAC.format(graphs=graphs))
    stage = f"../{root}" if attached else root
    command = {"python": "./python.sh" if graphs else "python", "root": quote(stage)}
    parts += [_SCRIPT.format(script=s, onnx=quote(onnx or "NETWORK.onnx"), **command) for s in scripts]
    if plugin:
        parts.append(_PLUGIN)
    if map_prim:
        parts.append((_FLAT_MAP if flat else _MAP).format(map=map_prim))
    if magnetometer:
        parts.append(_NETWORK.format(prim=magnetometer) + (_ATTACHED if attached else ""))
    said = "\n".join(f"- `{file}`: {licence}" for file, licence in licences.items())
    parts.append(_LICENCES.format(source=source, checksum=checksum, licences=said or "- none is stated"))
    if notes:
        parts.append("\n## Notes\n\n" + "\n".join(f"- {note}" for note in notes) + "\n")
    return "".join(parts)
