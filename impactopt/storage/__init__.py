"""Files on disk: written whole or not at all, private ones, hashes of what is in them, and its keys.

Look here where a file is damaged or in the wrong place.
"""
