"""Packet logs of receivers: CSV, JSON lines, raw bytes, and uplinks of LoRaWAN network servers."""
