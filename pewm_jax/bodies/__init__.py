"""Articulated agents: joints, shapes, and motions of their arms."""
