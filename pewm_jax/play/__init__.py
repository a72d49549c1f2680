"""The live viewer: drive through an imagined world, watch its map grow, edit it.

========  ============================================================================
file      content
========  ============================================================================
settings  where a drive begins and how the page is served
places    the frames before the drive: a house, a mesh, an episode, a recording
engine    a world model as compiled programs
session   the state of a drive and its events: pure functions, no server, no threads
board     the picture of a step
saved     saved worlds and videos
driver    a thread that handles requests, the newest step first; errors become messages
picking   a box chosen on the screen
map_view  the map in 3D
panels    the status line and the panel of saved files
serving   the server: its address, the browser, the refusal of pages of other sites
page      the page, built with viser
========  ============================================================================
"""
