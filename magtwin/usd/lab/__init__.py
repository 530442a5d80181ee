"""A lab on a stage: the room, the Earth's field, furniture, magnetised things, obstacles, and their looks."""
