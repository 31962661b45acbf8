"""Learned baselines: metric depth of single images, which knows no pose."""
