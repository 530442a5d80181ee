"""Load a stage in Newton, in a separate process: its schemas must be registered before USD is used.

    python -m magtwin.export.validation.newton_load STAGE

Prints one line of JSON: numbers of bodies, joints and shapes in Newton, and their mass.
"""

import json
import sys

import newton
import newton_usd_schemas  # noqa: F401 - registers them


def main(stage: str) -> None:
    """Load a stage, and print the result."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_usd(stage, load_visual_shapes=False, load_static_visual_shapes=False)
    model = builder.finalize(device="cpu")
    seen = {
        "bodies": model.body_count,
        "joints": model.joint_count,
        "shapes": model.shape_count,
        "mass_kg": float(model.body_mass.numpy().sum()),
    }
    sys.stdout.write("\n" + json.dumps(seen) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
