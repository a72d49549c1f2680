"""The live viewer: drive through an imagined world, watch its map grow, edit it.

========  ============================================================================
file      content
========  ============================================================================
settings  the start of a drive and the server's settings
places    the frames before the drive: a house, a mesh, an episode, a recording
engine    a world model as compiled programs
session   the state of a drive and its events: pure functions, no server, no threads
board     the image of a step
saved     saved worlds and videos
driver    a thread that handles requests, the newest step first; errors become messages
picking   selection of a box on the screen
map_view  the map in 3D
serving   the server: its address, the browser, and rejection of pages of other sites
page      the page, built with viser
========  ============================================================================
"""
