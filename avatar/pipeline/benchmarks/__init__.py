"""How fast it is: races of the main job against slow references and rivals, and what is made of their times."""
