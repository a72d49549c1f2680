"""Kinds of objects in a house, derived from the names that the generator gives its parts."""

from __future__ import annotations

import re

OTHER = "other"
"""The kind of parts whose name is not informative, such as those of a user's mesh."""
SHELL = ("wall", "floor", "ceiling", "trim", "doorway", "window")
MOVING = ("door", "robot")
_FURNITURE = """
armchair bathtub bed bookshelf ceiling_lamp chair clock coat_rack coffee_table desk dining_table
dresser fireplace floor_lamp fridge kitchen_counter nightstand office_chair piano picture plant rug
sofa stove toilet toy_chest tv_stand wall_shelf wardrobe washbasin washing_machine
"""
FURNITURE = tuple(_FURNITURE.split())
KINDS = (OTHER, *SHELL, *MOVING, *FURNITURE)
"""All kinds; their order is part of the data format, so new ones go last."""
GROUPS = {
    **dict.fromkeys(("wall", "trim", "doorway"), "wall"),
    **{kind: kind for kind in (OTHER, "floor", "ceiling", "window", *MOVING)},
    **dict.fromkeys(FURNITURE, "furniture"),
    **dict.fromkeys(("rug", "picture", "clock", "ceiling_lamp", "wall_shelf"), "decoration"),
}
"""A coarser division into groups, for small models."""
_NODE = re.compile(
    r"room\d+-(?:[a-z]+-(?P<shell>wall|floor|ceiling|trim|window)|(?P<piece>[a-z_]+)-\d)"
    r"|(?P<part>doorway|door|robot)\d"
)


def kind_of(node: str) -> str:
    """Return the kind of a part of a house by its name, e.g. ``sofa`` for ``room0-sofa-3``."""
    found = _NODE.match(node)
    kind = next((group for group in found.groups() if group), OTHER) if found else OTHER
    return kind if kind in GROUPS else OTHER
