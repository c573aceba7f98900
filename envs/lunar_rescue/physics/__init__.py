"""The world a scene becomes: simulator, robot, astronaut and the arms' kinematics (P6)."""
