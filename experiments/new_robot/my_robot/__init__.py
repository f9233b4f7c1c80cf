"""My robot: a soft robot for softwarp, and a task for it."""

from my_robot.task import MyRobot, MyRobotConfig

__all__ = ["MyRobot", "MyRobotConfig"]
