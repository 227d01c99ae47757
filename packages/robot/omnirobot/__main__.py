from omnirobot.commands import main

main()
