"""Cameras as sources of live frames and samples, one file each, behind the protocol of
`vio.sources.source`.
"""
