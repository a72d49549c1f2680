"""Chapter 11, the live viewer: drive through an imagined world, watch its map grow, edit it.

========  ===========================================================================
file      what is in it
========  ===========================================================================
settings  where a drive begins and how the page is served
places    what is seen before the drive: a house, a mesh, an episode, a recording
engine    a world model, compiled
session   the drive itself: state in, event in, state out; no server, no threads
board     the picture of a step
kept      worlds in files
requests  what a driver is asked for, and what it tells
driver    a thread that takes requests, the newest step first; errors become a sentence
picking   a box chosen on the screen
map_view  the map in 3D
visitors  who may talk to the page: no page of another site
serving   its address, who reaches it, the browser
page      the page, by viser
========  ===========================================================================
"""
