"""LoRa radio of CERPMs: time on air, link budget, collisions, regulation, LoRaWAN."""
