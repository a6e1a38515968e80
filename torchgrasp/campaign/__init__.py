"""Campaigns: a data set of clouds, grasps, certificates and verdicts, made on processes here or on a cluster."""

from torchgrasp.campaign.run import CampaignSpec
from torchgrasp.campaign.run import run_campaign

__all__ = ["CampaignSpec", "run_campaign"]
