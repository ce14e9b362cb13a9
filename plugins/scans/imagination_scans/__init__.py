"""Scanned buildings: Matterport3D, HM3D, Replica and what scenezoo reads, each floor a scene."""
