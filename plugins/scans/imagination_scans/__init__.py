"""Scanned buildings of Matterport3D, HM3D, Replica and the data sets of scenezoo; each floor is a scene."""
