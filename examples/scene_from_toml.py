"""Write the TOML of a small furnished room, author it as USD, and open it."""

import magtwin as mt

toml = mt.new_scene("room.toml")
stage = mt.author_scene(toml, out="room")
print(mt.open_twin(stage))
