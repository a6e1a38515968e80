"""Data on disk: folders of objects and views that are planned on, and shards of grasps that campaigns write."""

from torchgrasp.datasets.objects import ObjectEntry as ObjectEntry, list_objects as list_objects, list_views
from torchgrasp.datasets.objects import read_entry as read_entry, read_family as read_family, read_group as read_group
from torchgrasp.datasets.objects import read_mass as read_mass, read_object_mesh, read_view, write_objects
from torchgrasp.datasets.shards import JobRow
from torchgrasp.datasets.reader import GraspShards, ShardJob, read_shards

__all__ = [
    "GraspShards",
    "JobRow",
    "ShardJob",
    "list_views",
    "read_object_mesh",
    "read_shards",
    "read_view",
    "write_objects",
]
