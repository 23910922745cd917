from rover_lib.cli import main

main()
