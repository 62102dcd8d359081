"""What the mirrors' servos really are: steps measured on them to delay, bandwidth, damping, slew, and how sure."""
