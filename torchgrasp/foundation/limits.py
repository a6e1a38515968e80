"""Limits for reading files that anyone may have written: a file beyond a limit is rejected with an error."""

MIN_EXTENT, MAX_EXTENT = 0.005, 2.0  # smallest and largest object [m]: beyond them the unit is most likely wrong
MESSAGE_LETTERS = 600  # longest part of an error message: other libraries quote whole files
SHOWN_LETTERS = 60  # longest wrong value that an error message quotes
PATH_BYTES, NAME_BYTES = 4095, 255
"""Longest path and longest file name [bytes] on Linux; other systems allow no longer ones."""
TENSOR_FILE_BYTES = 1024**3  # largest safetensors file
LARGEST_NUMBER = 1e30  # largest number in a safetensors file: beyond it squares overflow
JSON_BYTES, JSON_LETTERS = 32 * 1024**2, 200  # largest JSON file, and the longest text in it
MESH_BYTES, MESH_FACES = 50 * 1024**2, 500_000  # largest mesh file, and its most faces
PLY_HEADER_BYTES, PLY_PROPERTIES = 65_536, 256
"""Largest header [bytes] of a .ply file, and largest number of its properties: reading time grows as its square."""
CLOUD_BYTES, CLOUD_POINTS = 512 * 1024**2, 5_000_000
"""Largest file [bytes] of a cloud, a scene or an image, packed or unpacked, and largest number of its points."""
TEXT_COLUMNS, LINE_LETTERS = 16, 4096  # most numbers of a point in a text file, and the longest line
TEXT_MESH_BYTES = 64 * 1024**2
"""Largest text file [bytes] of a mesh from which a cloud is sampled: reading needs many times this memory."""
URDF_BYTES, TOML_BYTES = 4 * 1024**2, 1024**2  # largest URDF and largest hand.toml
XML_DEPTH, XML_ELEMENTS, XML_LETTERS = 64, 50_000, 200
"""Deepest nesting of a URDF's elements, largest number of elements, and largest number of letters in a name."""
HAND_LINKS, HAND_SHAPES, HAND_SHAPE_PAIRS = 512, 1000, 20_000
"""Largest numbers of links, of collision shapes, and of shape pairs tested for self-collision in a hand."""
HAND_MESH_BYTES = 4 * MESH_BYTES  # largest size of all meshes of a hand
HAND_SEPARATIONS = 20_000_000
"""Largest number of distances between shapes that are measured to find the pairs of links that can collide."""
