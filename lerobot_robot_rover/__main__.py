"""python -m lerobot_robot_rover ARTIFACT FOLDER"""

from lerobot_robot_rover.pack import main

main(prog_name="python -m lerobot_robot_rover")
