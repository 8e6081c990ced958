"""The camera that films a robot, by what moves in its video and by the joints."""
