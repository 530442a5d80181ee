"""Runs in Blender's Python (bpy 5.0), not in ours: import a stage, and report what came or render it.

    PYTHON tests/in_blender.py report STAGE
    PYTHON tests/in_blender.py render STAGE OUT.png ENGINE EYE TARGET ANGLE_DEG

`report` prints a line of JSON, the last line. EYE and TARGET are x,y,z.
"""

import json
import math
import sys

import bpy
from mathutils import Vector

SIZE = (640, 400)
SAMPLES = 32


def import_stage(stage):
    """Import a stage into an empty file with Blender's default options."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("World")
    bpy.ops.wm.usd_import(filepath=stage)


def report():
    """Meshes, those of which a face has no material, the box around them, and the lights."""
    count, bare, corners = 0, [], []
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        thing = instance.object
        if thing.type != "MESH":
            continue
        count += 1
        slots = [slot.material for slot in thing.material_slots]
        used = {polygon.material_index for polygon in thing.data.polygons}
        if any(k >= len(slots) or slots[k] is None for k in used):
            bare.append(thing.name)
        corners += [instance.matrix_world @ Vector(corner) for corner in thing.bound_box]
    background = next(n for n in bpy.context.scene.world.node_tree.nodes if n.type == "BACKGROUND")
    return {
        "meshes": count,
        "without_material": bare,
        "low": [min(c[k] for c in corners) for k in range(3)],
        "high": [max(c[k] for c in corners) for k in range(3)],
        "lamps_w": [light.energy for light in bpy.data.lights],
        "sky": background.inputs["Strength"].default_value,
    }


def render(out, engine, eye, target, angle_deg):
    """Render the scene as seen from `eye`; the engine is CYCLES or HYDRA_STORM."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    eye, target = (Vector(map(float, text.split(","))) for text in (eye, target))
    camera.location = eye
    camera.rotation_euler = (target - eye).to_track_quat("-Z", "Y").to_euler()
    camera.data.sensor_fit, camera.data.angle = "VERTICAL", math.radians(float(angle_deg))
    if engine == "HYDRA_STORM":
        bpy.ops.preferences.addon_enable(module="hydra_storm")
        scene.render.film_transparent = True
    scene.render.engine = engine
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.view_settings.view_transform = "Standard"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = SAMPLES, True, 0
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.filepath = out
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    task, stage, *rest = sys.argv[1:]
    import_stage(stage)
    if task == "render":
        render(*rest)
    else:
        sys.stdout.write(f"{json.dumps(report())}\n")
