"""The paper's measured numbers as a recording: what Text S1 gets wrong in them, and what mending it gains."""
