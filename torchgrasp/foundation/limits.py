"""Limits for reading files that anyone may have written: a file beyond a limit is rejected with an
error.
"""

# smallest and largest object [m]: beyond them the unit is most likely wrong
MIN_EXTENT = 0.005
MAX_EXTENT = 2.0
MESSAGE_LETTERS = 600  # longest part of an error message: other libraries quote whole files
SHOWN_LETTERS = 60  # longest wrong value that an error message quotes
PATH_BYTES = 4095
NAME_BYTES = 255
"""Longest path and longest file name [bytes] on Linux; other systems allow no longer ones."""
TENSOR_FILE_BYTES = 1024**3  # largest safetensors file
LARGEST_NUMBER = 1e30  # largest number in a safetensors file: beyond it squares overflow
# largest JSON file, and the longest text in it
JSON_BYTES = 32 * 1024**2
JSON_LETTERS = 200
# largest mesh file, and its most faces
MESH_BYTES = 50 * 1024**2
MESH_FACES = 500_000
PLY_HEADER_BYTES = 65_536
PLY_PROPERTIES = 256
"""Largest header [bytes] of a .ply file, and largest number of its properties: reading time grows
as its square.
"""
CLOUD_BYTES = 512 * 1024**2
CLOUD_POINTS = 5_000_000
"""Largest file [bytes] of a cloud, a scene or an image, packed or unpacked, and largest number of
its points.
"""
# most numbers of a point in a text file, and the longest line
TEXT_COLUMNS = 16
LINE_LETTERS = 4096
TEXT_MESH_BYTES = 64 * 1024**2
"""Largest text file [bytes] of a mesh from which a cloud is sampled: reading needs many times this
memory.
"""
# largest URDF and largest hand.toml
URDF_BYTES = 4 * 1024**2
TOML_BYTES = 1024**2
XML_DEPTH = 64
XML_ELEMENTS = 50_000
XML_LETTERS = 200
"""Deepest nesting of a URDF's elements, largest number of elements, and largest number of letters
in a name.
"""
HAND_LINKS = 512
HAND_LINK_MASS = 50.0  # [kg]; palms weigh 0.1 to 1 kg, so that more is most likely in grams
HAND_SHAPES = 1000
HAND_SHAPE_PAIRS = 20_000
"""Largest numbers of links, of collision shapes, and of shape pairs tested for self-collision in a
hand.
"""
HAND_MESH_BYTES = 4 * MESH_BYTES  # largest size of all meshes of a hand
HAND_SEPARATIONS = 20_000_000
"""Largest number of distances between shapes that are measured to find the pairs of links that can
collide.
"""
