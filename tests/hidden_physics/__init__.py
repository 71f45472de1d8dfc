"""An arm with physics that the software under test does not know, and cases to judge its diagnosis by.

The equations here are written for this purpose and share no code with the dictionary of effects: friction is
carried by bristles with their own differential equations, warmth comes from the power that friction
dissipates, cables and gears have their own laws, the torque sensors a chain of faults of their own. All of it
runs inside the emulated cabinet and reaches the software as session logs only.

`traits` : what can be changed in a joint. `bristles`, `arm` : the plant. `sensing` : the sensor chain.
`robots` : healthy arms with their honest tolerances. `causes` : what can be hidden. `cases` : drawing them
from seeds. `recording` : from a case to session logs. `inflation` : how visible a case is. `verdict` : a
diagnosis against the truth.
"""
