"""Reads glTF scenes and states facts about their materials and media."""
