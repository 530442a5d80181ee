"""Convert a URDF to a USD articulation that drives."""

import magtwin as mt

URDF = """<robot name="cart">
  <link name="base_link">
    <inertial><mass value="5"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.3 0.3 0.1"/></geometry></collision>
    <visual><geometry><box size="0.3 0.3 0.1"/></geometry></visual>
  </link>
</robot>"""

with open("cart.urdf", "w") as file:
    file.write(URDF)
robot = mt.from_urdf("cart.urdf", "cart/cart.usda")
print(robot.asset)
print(robot.report)
