"""What moves and weighs: links, joints, drives, wheels and contact, as UsdPhysics has them."""
