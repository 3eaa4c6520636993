"""What is on the road: layout, code and capacity of each marker family, and the outcomes of reading one."""
