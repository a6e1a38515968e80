"""Shipped objects, folders of objects and views, and data sets of grasps in shards."""

from torchgrasp.data.shipped import GraspObject, load_shipped_grasp
from torchgrasp.data.manifest import (
    ObjectEntry as ObjectEntry,
    read_entries as read_entries,
    read_entry as read_entry,
)
from torchgrasp.data.manifest import list_views, read_object_mesh, read_view, write_objects
from torchgrasp.data.shards import JobRow
from torchgrasp.data.reader import GraspShards, ShardJob, read_shards
from torchgrasp.data.parquet import write_parquet
from torchgrasp.data.lerobot import write_lerobot

__all__ = [
    "GraspObject",
    "GraspShards",
    "JobRow",
    "ShardJob",
    "list_views",
    "load_shipped_grasp",
    "read_object_mesh",
    "read_shards",
    "read_view",
    "write_lerobot",
    "write_objects",
    "write_parquet",
]
