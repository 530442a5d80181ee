"""What a robot description contains: links, joints, sensors, drives."""
