"""What is known of robots and of the messages that tell their power: TOML files beside this one, read by `tcpipe.formats.recipe_toml`.

A recipe holds the same tables, ``[robots.NAME]`` and ``[[power_sources]]``; they go before these.
"""
