"""Chapter 11, the live viewer: drive through an imagined world, watch its map grow, edit it.

settings   where a drive begins and how the page is served
places     what is seen before the drive: a house, a mesh, an episode, a recording
engine     a world model, compiled
session    the drive itself: state in, event in, state out; no server, no threads
board      the picture of a step
kept       worlds in files
driver     a thread that takes events, newest first, and turns errors into a sentence
page       the page, by viser: the only file that knows of it, beside ``extra``
"""
