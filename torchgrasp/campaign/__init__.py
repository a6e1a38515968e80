"""Campaigns: data sets of clouds, grasps, certificates and simulated verdicts, made by many
processes or machines.
"""

from torchgrasp.campaign.campaign import CampaignSpec, run_campaign

__all__ = ["CampaignSpec", "run_campaign"]
