"""What a plan hands out: bill, stakeout, drawings, sheets, schedule, and the document that it is stored as."""
