"""The objects of the headline: 37 of 20 families, on which no ranking, fit or constant was chosen."""

LEFT_OUT = tuple(
    """
    cdb_spheremedium ycb_baseball ycb_softball hope_chocolate_pudding ycb_gelatin_box
    kit_chocolatebars ds_potato_chip_2 kit_cokeplasticsmall kit_melforbottle
    kit_sprudelflasche cdb_eyeglasses kit_heringtin kit_sardinescan hope_alphabet_soup
    kit_choppedtomatoes kit_orangemarmelade cdb_fryingpan ds_black_marker ycb_cups_b
    ycb_cups_e ycb_cups_h ycb_nine_hole_peg_test cdb_pyramidlarge cdb_pyramidmedium
    ds_remote_controller_1 ds_remote_controller_2 ycb_flat_screwdriver
    ycb_phillips_screwdriver ds_conditioner kit_shampoo kit_showergel cdb_cubesmall
    cdb_cylindersmall ycb_colored_wood_blocks_b ycb_spatula kit_tortoise cdb_watch
    """.split()
)
"""Names of objects in a folder of 66 public scans and prints (`scripts/bench.py --objects`)."""

PACED = (
    *("cdb_spheremedium", "hope_chocolate_pudding", "ds_potato_chip_2", "kit_cokeplasticsmall"),
    *("kit_heringtin", "ycb_cups_b", "cdb_pyramidlarge", "ds_remote_controller_1"),
    *("ycb_phillips_screwdriver", "kit_shampoo", "cdb_cubesmall", "ycb_spatula"),
)
"""Twelve of them, each of another family, on which plans are timed."""
