"""NeuBTF as it is used: as published, and with the heights and features of NeuMIP."""
