"""From a list of tasks to missions that fly: files of operators in, checked plans and mission files out."""
