"""Stages of a step, one file each; `pipeline.assemble` binds those that a scene requires."""
