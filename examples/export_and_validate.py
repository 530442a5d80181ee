"""Export a scene for Isaac Sim and as one file, and validate both."""

import magtwin as mt

lab = mt.author_scene("lab", out="lab")
package = mt.export_scene(lab, "for_isaac", profile="isaac")
mt.export_scene(lab, "lab.usdz")
for file in (package.root, "lab.usdz"):
    print(mt.validate(file, against=["core", "magtwin"]))
