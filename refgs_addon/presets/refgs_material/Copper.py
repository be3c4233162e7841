base_color = (0.955, 0.638, 0.538, 1.0)
color_amount = 1.0
metallic = 1.0
metallic_amount = 1.0
roughness = 0.2
roughness_amount = 1.0
