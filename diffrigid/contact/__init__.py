"""The contact model: exact impacts at their true times within a step, smooth ones for width > 0, and rest.

To read it, in the order of a step; `model.py` first, which runs the passes:

    where paths begin     anchors.py
    when shapes meet      impact.py; a search (search.py, approach.py, nearing.py, gaps.py) where there is
                          no closed form; what rests is held up meanwhile (held_up.py, supported.py)
    all of them           strikes.py lists the contacts, materials.py has their coefficients, stops.py the rows of
                          joints, rolling.py those against turning; sums.py adds up over the contacts of each body
    whose turn it is      order.py
    one contact           impulse.py
    many at once          resting.py, together.py (the law in cone.py, its derivative in slope.py, bodies in
                          mobility.py, another start in multipliers.py); gain.py where an impact would gain energy
    what it does          apply.py, levers.py, slipping.py, known.py

Discs and spheres go faster ways: isolated.py and slots.py (some dozen), crowd.py and grid.py (hundreds).
"""

from diffrigid.contact.impulse import contact_law
from diffrigid.contact.model import Contact

__all__ = ["Contact", "contact_law"]
